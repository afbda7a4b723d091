"""Scripted experts and the collection of their demonstrations."""
