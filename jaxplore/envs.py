"""In a checkout, the folder `envs/` by the name that it has in the wheel: `import jaxplore.envs`."""

from jaxplore._install import checkout

checkout.alias("envs")
