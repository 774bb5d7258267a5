"""Every file format, both ways; no other room opens files."""
