"""What judges a model: zero-shot classification, classifiers that share nothing with what they judge, and controls."""
