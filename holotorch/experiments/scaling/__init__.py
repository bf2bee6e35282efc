"""Chart of one run on several processes: measured on two, and a model of its cost on many GPUs."""
