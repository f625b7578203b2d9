"""What a run did: success rates, answers, wordings."""
