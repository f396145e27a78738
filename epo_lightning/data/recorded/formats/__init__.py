"""Recording formats, one file each: a function from a folder to the recordings in it."""
