"""How good an answer is for the time it takes: exact problems, work-precision, stability."""
