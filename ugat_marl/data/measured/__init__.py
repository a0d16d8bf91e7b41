"""Measured data of the street: detectors, signals and detections in periods, read and written."""
