"""Recipes that train the joint space and the generators: one objective a module, one trainer for all."""
