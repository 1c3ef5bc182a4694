"""Frames from the line sensor: commands, links to the microcontroller, capture and files.

Nothing is imported here, so that a program that only prints its help starts at once; see
`acquisition.capture` for what to begin with.
"""
