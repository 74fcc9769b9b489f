"""Mazes: layouts and paths, the bodies that move in them, and their tasks."""
