"""Fidelity: the same agents in other physics engines, and what differs."""
