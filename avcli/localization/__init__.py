"""Where sound comes from: events, generalised cross-correlation, closed-form and steered-response localization."""
