"""Residuals of a model, and what is fitted to them: pure functions that a user jits, differentiates and batches."""
