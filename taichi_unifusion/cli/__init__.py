"""`unifusion`: one file a command."""
