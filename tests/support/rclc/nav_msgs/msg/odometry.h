#ifndef NAV_MSGS_ODOMETRY_H
#define NAV_MSGS_ODOMETRY_H
#include <stdbool.h>

typedef struct { double x, y, z; } geometry_msgs__msg__Vector3;
typedef struct { double x, y, z, w; } geometry_msgs__msg__Quaternion;
typedef struct {
    struct {
        struct {
            geometry_msgs__msg__Vector3 position;
            geometry_msgs__msg__Quaternion orientation;
        } pose;
    } pose;
    struct { struct { geometry_msgs__msg__Vector3 linear, angular; } twist; } twist;
} nav_msgs__msg__Odometry;

bool nav_msgs__msg__Odometry__init(nav_msgs__msg__Odometry *message);
#endif
