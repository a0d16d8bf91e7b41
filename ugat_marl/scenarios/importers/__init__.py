"""Importers: road networks from anywhere, made into scenario directories."""
