"""Physics engines that step many worlds of one model (one per environment), and selections of these worlds."""
