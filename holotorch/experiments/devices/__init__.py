"""Chart of the same computations on every device of a machine: its processor, and its GPU if it has one."""
