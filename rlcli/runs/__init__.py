"""The folder of a run: checkpoints, records, references and comparisons."""
