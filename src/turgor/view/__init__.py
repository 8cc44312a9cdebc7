"""Pictures and videos of recordings, figures of runs; each module loads its own libraries."""
