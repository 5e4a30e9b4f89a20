# SPDX-License-Identifier: Apache-2.0
"""The ROS side of ctsid: messages, bags, files, node and command line around `ctsid_core`."""
