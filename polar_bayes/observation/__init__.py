"""From predicted to recorded: data as arrays, noise schedules, likelihood links."""
