"""Learning half of the studio: features, networks, training, and running what was trained."""

import os

# Read by OpenMP when torch is loaded, so set before. By default its threads wait for each other in a long
# spin: with other programs on the same cores a training step then takes 20 times as long. Sleeping at once
# costs a third of the speed on an idle machine; a spin of some microseconds costs neither much.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "10000")
