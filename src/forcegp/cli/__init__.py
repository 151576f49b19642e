"""The command `forcegp`. Each command is a file of its own; libraries are imported when a command runs."""
