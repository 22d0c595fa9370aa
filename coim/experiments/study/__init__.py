"""Many runs that are compared: definition, arms, ledger, scheduling, archive."""
