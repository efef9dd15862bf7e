"""Zero-shot classification and retrieval, the paper's tables, and the controls that figures are read beside."""
