"""Reads records and draws pictures and tables; computes nothing."""
