"""Pictures of a simulation: cameras, still images, videos.

    record(simulation, spec) -> Footage -> Film -> write_image, write_video

A `Film` combines in one picture the scene (`Stage`, drawn by MuJoCo through a `Camera`) and the
map and traces around it (`Sheet`, drawn by matplotlib), on one `ForceScale`.
"""
