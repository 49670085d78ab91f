"""Figures and pictures of trainings and scenes."""
