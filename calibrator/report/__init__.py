"""Figures, tables and pictures for people."""
