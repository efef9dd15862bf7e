"""What judges a model: zero-shot classification, and classifiers that share nothing with what they judge."""
