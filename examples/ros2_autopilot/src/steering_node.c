/* A ROS 2 node in C that steers with an exported heading policy; nothing but rclc and messages.

   odometry  nav_msgs/Odometry in ROS' frames: world east-north-up, vessel forward-left-up
   heading   std_msgs/Float64, the heading to steer in rad, clockwise from north; until one comes
             the vessel keeps the heading that it is first seen with
   rudder    std_msgs/Float64, the command in rad; where it is positive the bow turns to starboard
   fault     std_msgs/Bool, whether the command is the safe one of the policy's card

   MODEL, MODEL_UPPER and MODEL_HEADER name the exported C; CMakeLists.txt gives them. */
#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>

#include <rcl/rcl.h>
#include <rclc/executor.h>
#include <rclc/rclc.h>
#include <nav_msgs/msg/odometry.h>
#include <std_msgs/msg/bool.h>
#include <std_msgs/msg/float64.h>

#include MODEL_HEADER

#define JOINED_(a, b) a##_##b
#define JOINED(a, b) JOINED_(a, b)
#define OF(part) JOINED(MODEL, part)
#define SIZE(part) JOINED(MODEL_UPPER, part)

/* odometry that is older than this many seconds is none */
#define PATIENCE 1.0
#define HALF_TURN 3.14159265358979323846

static nav_msgs__msg__Odometry odometry;
static std_msgs__msg__Float64 asked;
static rcl_publisher_t rudder, fault;

static OF(real) measured[SIZE(SIZE_Y)], reference[SIZE(SIZE_REFERENCE)], memory[SIZE(SIZE_S)];
static bool begun = false;
static double silent = 0.0, steered = NAN;

static void on_odometry(const void *message) {
    const nav_msgs__msg__Odometry *seen = (const nav_msgs__msg__Odometry *)message;
    double x = seen->pose.pose.orientation.x, y = seen->pose.pose.orientation.y;
    double z = seen->pose.pose.orientation.z, w = seen->pose.pose.orientation.w;
    double yaw = atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z));
    /* heading, speed and yaw rate, as the card lists them: from north, to starboard */
    measured[0] = (OF(real))(0.5 * HALF_TURN - yaw);
    measured[1] = (OF(real))seen->twist.twist.linear.x;
    measured[2] = (OF(real))-seen->twist.twist.angular.z;
    silent = 0.0;
    if (begun) return;
    begun = true;
    OF(initial_state)(measured, memory);
    if (isnan(steered)) steered = measured[0];
}

static void on_heading(const void *message) {
    steered = ((const std_msgs__msg__Float64 *)message)->data;
}

static void on_time(rcl_timer_t *timer, int64_t since) {
    std_msgs__msg__Float64 command = {0.0};
    std_msgs__msg__Bool wrong = {true};
    (void)timer;
    (void)since;
    if (begun) {
        OF(real) angle[1];
        /* the policy answers what is no number with its safe command */
        if (silent > PATIENCE) measured[0] = (OF(real))NAN;
        silent += SIZE(DT);
        reference[0] = (OF(real))steered;
        wrong.data = OF(step)(measured, reference, memory, angle, memory) != 0;
        command.data = angle[0];
    }
    if (rcl_publish(&rudder, &command, NULL) != RCL_RET_OK
        || rcl_publish(&fault, &wrong, NULL) != RCL_RET_OK)
        fprintf(stderr, "steering: a command was not published\n");
}

#define NEEDS(call)                                              \
    do {                                                         \
        if ((call) != RCL_RET_OK) {                              \
            fprintf(stderr, "steering: %s failed\n", #call);     \
            return 1;                                            \
        }                                                        \
    } while (0)

int main(int argc, char **argv) {
    rcl_allocator_t allocator = rcl_get_default_allocator();
    rclc_support_t support;
    rcl_node_t node = rcl_get_zero_initialized_node();
    rcl_subscription_t on_pose = rcl_get_zero_initialized_subscription();
    rcl_subscription_t on_order = rcl_get_zero_initialized_subscription();
    rcl_timer_t timer = rcl_get_zero_initialized_timer();
    rclc_executor_t executor = rclc_executor_get_zero_initialized_executor();

    NEEDS(rclc_support_init(&support, argc, (char const *const *)argv, &allocator));
    NEEDS(rclc_node_init_default(&node, "steering", "", &support));
    rudder = fault = rcl_get_zero_initialized_publisher();
    NEEDS(rclc_publisher_init_default(
        &rudder, &node, ROSIDL_GET_MSG_TYPE_SUPPORT(std_msgs, msg, Float64), "rudder"));
    NEEDS(rclc_publisher_init_default(
        &fault, &node, ROSIDL_GET_MSG_TYPE_SUPPORT(std_msgs, msg, Bool), "fault"));
    NEEDS(rclc_subscription_init_default(
        &on_pose, &node, ROSIDL_GET_MSG_TYPE_SUPPORT(nav_msgs, msg, Odometry), "odometry"));
    NEEDS(rclc_subscription_init_default(
        &on_order, &node, ROSIDL_GET_MSG_TYPE_SUPPORT(std_msgs, msg, Float64), "heading"));
    NEEDS(rclc_timer_init_default(
        &timer, &support, (uint64_t)llround(1e9 * SIZE(DT)), on_time));
    NEEDS(rclc_executor_init(&executor, &support.context, 3, &allocator));
    if (!nav_msgs__msg__Odometry__init(&odometry)) return 1;
    NEEDS(rclc_executor_add_subscription(
        &executor, &on_pose, &odometry, on_odometry, ON_NEW_DATA));
    NEEDS(rclc_executor_add_subscription(&executor, &on_order, &asked, on_heading, ON_NEW_DATA));
    NEEDS(rclc_executor_add_timer(&executor, &timer));
    return rclc_executor_spin(&executor) == RCL_RET_OK ? 0 : 1;
}
