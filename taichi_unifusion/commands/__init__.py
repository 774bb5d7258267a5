"""The subcommands of `unifusion`, one file each: a dataclass of options, whose docstring is the help, and a function."""
