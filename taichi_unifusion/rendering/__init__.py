"""Triangles and solids to pictures: previews, legends, ray casting, rendered rooms."""
