"""Arguments of benchmarks that are lists of numbers; argparse refuses by name what is none."""


def whole_numbers(text: str) -> list[int]:
    """Whole numbers, separated by commas."""
    return [int(word) for word in text.split(",")]


def numbers(text: str) -> list[float]:
    """Numbers, separated by commas."""
    return [float(word) for word in text.split(",")]
