"""Evolution: strategies that propose controllers, and the loop that has them simulated."""
