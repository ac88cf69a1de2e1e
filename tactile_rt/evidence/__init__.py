"""Figures that are quoted to users: what a model can do, and how fast it is here."""
