"""Saved moments become segmentation masks and pictures: compiled z-buffer, camera, appearance of the scene."""
