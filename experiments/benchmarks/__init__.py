"""What takes how long, beside what else one could use: one script per question."""
