"""Scans from files and bytes: point clouds and depth images, bounded."""
