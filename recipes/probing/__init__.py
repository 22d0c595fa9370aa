"""How well a learnt model of the dynamics knows bodies, measured against the simulator."""
