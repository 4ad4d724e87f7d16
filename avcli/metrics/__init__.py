"""Scores of tracks and detections against ground truth: HOTA, CLEAR, identity, the OSPA family, positions."""
