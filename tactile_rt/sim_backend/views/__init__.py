"""Pictures of a simulation: cameras, still images, videos.

    record(simulation, spec) -> Footage -> Film -> write_image, write_video

A `Film` puts two things into one picture: the scene (`Stage`, drawn by MuJoCo through a `Camera`)
and what stands beside and below it (`Sheet`, drawn by matplotlib), on one `ForceScale`.
"""
