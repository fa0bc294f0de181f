"""Films of flashing labels whose truth is known, and scores of what a detector finds in them."""
