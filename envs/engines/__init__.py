"""What runs the physics of a `Task`: one module per engine, with `BACKEND` and `make_environment(task, obs_noise)`."""
