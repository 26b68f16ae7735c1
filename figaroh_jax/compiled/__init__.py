"""Compiled programs: many samples through one kernel (`batching`), programs kept on disk (`executable_cache`)."""
