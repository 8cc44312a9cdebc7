"""The paper's experiments: campaigns of runs, what they found, and the report."""
