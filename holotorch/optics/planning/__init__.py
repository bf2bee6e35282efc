"""Choice of a propagation method: field content, predicted errors, candidates, and the plan."""
