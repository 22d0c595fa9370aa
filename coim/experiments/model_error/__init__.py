"""How far the learnt dynamics are from the simulator."""
