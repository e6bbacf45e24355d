"""Many trainings: several seeds, sweeps over settings, and benchmarks of sizes and threads."""
