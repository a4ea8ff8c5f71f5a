TOUCHES: dict[str, tuple[str, ...]] = {}
