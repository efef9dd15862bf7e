"""How good it is: zero-shot classification, and judges that share nothing with what they judge."""
