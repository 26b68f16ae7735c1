"""Compiled programs: samples through one kernel (`batching`), programs kept on disk (`executable_cache`, `store`)."""
