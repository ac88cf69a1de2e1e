"""ROS 2 messages without a ROS 2 installation: definitions, CDR, names of topics and types.

    definitions    the package ``tactile_rt_msgs``, and the standard messages that it uses
    cdr            encoding of a message as bytes, by its definition
    messages       samples, decisions, events and arrays as these messages

Recordings consist of such messages, and the publisher ``ros2`` sends them.
"""
