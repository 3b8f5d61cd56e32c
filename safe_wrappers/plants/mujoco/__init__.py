"""A MuJoCo model as plant: linear model, rollouts, contacts, replay."""
