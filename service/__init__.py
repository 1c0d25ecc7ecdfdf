"""Everything with side effects: cameras, files, datalink, commands; joins recon and mavlink."""

import os

# Compiled loops of several stages share few cores. By default GNU OpenMP's idle threads spin
# for milliseconds after each loop, on a core that another stage needs. The variable is read when
# the first loop starts, so it must be set before any stage is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
