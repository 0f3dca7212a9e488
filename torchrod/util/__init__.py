"""What every package below may need: one error type, float64, whole files, progress, threads, status codes."""
