"""Parts as CAD has them: files to surfaces, the symmetry of a surface, the parts built in."""
