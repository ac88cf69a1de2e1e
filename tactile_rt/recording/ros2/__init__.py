"""ROS 2 without ROS 2: its message definitions, CDR, and the names of topics and types.

    definitions    the package ``tactile_rt_msgs``, and what it needs of others
    cdr            a message as bytes, by its definition
    messages       what we tell, as these messages

Recordings are made of such messages, and the publisher ``ros2`` sends them. Nothing of ROS need be
installed.
"""
