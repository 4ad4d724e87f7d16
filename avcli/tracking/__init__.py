"""Tracking: detections of several sensors become labelled tracks (MS-GLMB), in order of time, as they come.

`merging` puts records on one clock; `fusion` feeds them to a tracker (`glmb`, `gnn`) and delays its tracks by some
steps to smooth them (`smoothing`). `motion`, `gaussian` and `assignment` are what trackers are made of; `model` holds
what they are told and tell.
"""
