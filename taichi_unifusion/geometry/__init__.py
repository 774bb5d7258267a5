"""NumPy mathematics that several rooms need: rigid motions, triangles, time stamps."""
