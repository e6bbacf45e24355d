"""Physics engines that step many worlds of one model, and selections of these worlds."""
