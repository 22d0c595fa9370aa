"""Many runs that are compared: what they are, how far they have got, and who computes them."""
