"""Manufactured failures, and what the verdict of a result says of them."""
