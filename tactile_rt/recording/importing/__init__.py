"""Import of other files as recordings: `tactile-rt import`.

    wire         logs of a serial line or a CAN bus, decoded by a codec
    table_form   form of tables of numbers in text: delimiter, decimal mark, header
    table_guess  proposals of which columns are times and channels, and of the order of dates
    bag          topics of ROS 1 and ROS 2 bags, which bag_file opens and repairs
    table        shared by tables and bags: columns in words, times, writing the recording

A recording is written whole or not at all, and reports what was lost on the way.
"""
