"""Which way to propagate: the content, the error of each way, and the plan."""
