# ruff: noqa: N999  (the name is the original's)
"""Stand-in for RPi.GPIO where there is no Raspberry Pi."""
