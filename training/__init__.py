"""Recipes that train the joint space and the generators: one objective a module, one trainer for all."""

from unitouch_gen.aliases import alias_package

if __name__ == "training":  # imported by its folder's name
    alias_package(__name__)
