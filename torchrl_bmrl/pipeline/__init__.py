"""The two stages as functions: collect, stage 1, stage 2, evaluate, export."""
