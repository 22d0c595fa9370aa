"""What trains the networks: soft actor-critic and the dynamics ensemble, each over K runs at once."""
