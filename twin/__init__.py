"""The digital twin: the real firmware on an emulated microcontroller, and the world it measures."""
