"""The viewer: runs, replays and a playground in the browser."""
