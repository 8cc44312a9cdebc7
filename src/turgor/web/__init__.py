"""The viewer: a page that shows a folder of runs, its server, and what the page is fed with."""
