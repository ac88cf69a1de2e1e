"""The onboard daemon: sources, models and consumers, each in its own thread, restarted on failure.

    source --+--> mailbox --> model --> decisions --+
             |                                      |
             +--> mailbox <-------------------------+--> mailbox --> consumer (publisher, recorder,
                                                                     page, metrics, systemd, log)

Every mailbox is bounded, drops its oldest items and counts them, so that no slow or lost part ever
holds up acquisition. `Daemon` builds all parts from a `Config`, one TOML file.
"""
