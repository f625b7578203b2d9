"""Attribution patching: gradients estimate what exact patches would do, as a screen that says when it is void."""
