"""Reading and writing of files: import from its modules, such as ``holotorch.io.volumes``."""
