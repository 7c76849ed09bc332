"""Datasets, policies and environments are pushed to the Hugging Face Hub."""
