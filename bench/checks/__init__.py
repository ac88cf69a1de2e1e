"""Programs that ask one question and fail if the answer is no."""
