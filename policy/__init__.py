"""Learning half of the studio: features, networks, training, and running what was trained."""

import os

# Read by OpenMP when torch is loaded, so set before. By default its threads wait for each other in a spin:
# with other programs on the same cores a training step then takes 20 times as long. Sleeping costs little.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
