"""Offline data: files to one ``Dataset``, segments of it, its quality, and how the default sets are collected."""
