"""What makes pages of `docs/`: the site's hooks, and the page of all measured figures."""
