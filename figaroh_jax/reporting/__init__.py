"""What a person reads: pages (`report`), answer.json (`answer`), the terminal, and the words they share (`wording`)."""
