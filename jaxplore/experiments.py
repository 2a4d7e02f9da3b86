"""In a checkout, the folder `experiments/` by the name that it has in the wheel: `import jaxplore.experiments`."""

from jaxplore._install import checkout

checkout.alias("experiments")
