"""Reward code is read and rewritten: its components, terms, slopes and conditions."""
