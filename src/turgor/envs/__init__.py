"""Gymnasium environments: the tasks, step by step, for reinforcement learning."""
