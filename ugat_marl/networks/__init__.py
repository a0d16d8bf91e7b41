"""Road networks from anywhere: made, imported, looked at and drawn."""
