"""What a plant's hold and delay leave of a controller's phase margin."""

from safe_wrappers.appendix.sampling import margin_left
from safe_wrappers.errors import ConfigurationError
from safe_wrappers.plants.plant import Plant


def phase_margin_left(plant: Plant, phase_margin: float, crossover: float) -> float:
    """Phase margin in rad that a loop through this plant keeps of its continuous, delay-free design.

    The plant's `delay_s` (evidence, detection and actuation together) and half its `hold_s` are what the loop is
    late by. See `safe_wrappers.appendix.sampling` for where that holds: well below the sampling frequency.

    Args:
        plant: Any plant that knows its hold; a `MujocoPlant` learns it from the env when it is bound.
        phase_margin: Margin of the controller's design, rad.
        crossover: Crossover frequency of its open loop, rad/s, below the Nyquist frequency.

    Returns:
        What is left, rad; zero or less means that the stated reserve is used up.

    Raises:
        ConfigurationError: For a plant without a hold yet, a crossover that is not positive or not below the
            Nyquist frequency, or a margin that is not finite.
    """
    hold_s = getattr(plant, "hold_s", None)
    if hold_s is None:
        raise ConfigurationError(
            "this plant does not know its hold_s yet: it reads it from the env; call plant.bind(env), or put it "
            "into a CBFActionFilter first"
        )
    return float(margin_left(phase_margin, crossover, hold_s, plant.delay_s))
