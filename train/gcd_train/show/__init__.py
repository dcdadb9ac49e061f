"""A scene as people look at it: contact sheet, video, camera path in space, facts."""
