"""Simulators behind one `contract`: this library's own (`native`), others by name (`registry`)."""
