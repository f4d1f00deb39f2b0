"""The weights that come with the package: their cards, and how far another training is from them."""
