"""Recordings of traffic and pedestrians: their formats, and the way from tracks to scenes."""
