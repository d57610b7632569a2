/* Drives a node as rclc does: messages that have come are taken, then the timer fires. */
#include <string.h>

#include <nav_msgs/msg/odometry.h>
#include <rcl/rcl.h>
#include <rclc/executor.h>
#include <rclc/rclc.h>
#include <std_msgs/msg/bool.h>
#include <std_msgs/msg/float64.h>

/* a row given: odometry came, quaternion, u, yaw rate; a heading came, heading */
enum { GIVEN = 9, TAKEN = 2 };
static const double *given;
static double *taken, period;
static int steps;

int node_main(int argc, char **argv);

/* rows given [steps, 9] to rows published [steps, 2]; the timer's period in s, or -1 */
double drive(const double *rows, int count, double *published) {
    char name[] = "steering", *argv[] = {name, NULL};
    given = rows, taken = published, steps = count, period = -1.0;
    return node_main(1, argv) == 0 ? period : -1.0;
}

rcl_allocator_t rcl_get_default_allocator(void) { rcl_allocator_t a = {0}; return a; }
rcl_node_t rcl_get_zero_initialized_node(void) { rcl_node_t n = {NULL}; return n; }
rcl_publisher_t rcl_get_zero_initialized_publisher(void) {
    rcl_publisher_t p = {NULL, NULL};
    return p;
}
rcl_subscription_t rcl_get_zero_initialized_subscription(void) {
    rcl_subscription_t s = {NULL, NULL};
    return s;
}
rcl_timer_t rcl_get_zero_initialized_timer(void) { rcl_timer_t t = {0, NULL}; return t; }
rclc_executor_t rclc_executor_get_zero_initialized_executor(void) {
    rclc_executor_t e;
    memset(&e, 0, sizeof e);
    return e;
}
rcl_ret_t rclc_support_init(rclc_support_t *support, int argc, char const *const *argv,
                            rcl_allocator_t *allocator) {
    support->context.valid = 1;
    return argc == 1 && argv && allocator ? RCL_RET_OK : RCL_RET_ERROR;
}
rcl_ret_t rclc_node_init_default(rcl_node_t *node, const char *name, const char *space,
                                 rclc_support_t *support) {
    node->name = name;
    return space && support->context.valid ? RCL_RET_OK : RCL_RET_ERROR;
}
rcl_ret_t rclc_publisher_init_default(rcl_publisher_t *publisher, const rcl_node_t *node,
                                      const rosidl_message_type_support_t *type,
                                      const char *topic) {
    publisher->topic = topic, publisher->type = type;
    return node->name ? RCL_RET_OK : RCL_RET_ERROR;
}
rcl_ret_t rclc_subscription_init_default(rcl_subscription_t *subscription, rcl_node_t *node,
                                         const rosidl_message_type_support_t *type,
                                         const char *topic) {
    subscription->topic = topic, subscription->type = type;
    return node->name ? RCL_RET_OK : RCL_RET_ERROR;
}
rcl_ret_t rclc_timer_init_default(rcl_timer_t *timer, rclc_support_t *support,
                                  const uint64_t every, const rcl_timer_callback_t callback) {
    timer->period = every, timer->callback = callback;
    return support->context.valid ? RCL_RET_OK : RCL_RET_ERROR;
}
rcl_ret_t rclc_executor_init(rclc_executor_t *executor, rcl_context_t *context,
                             const size_t handles, const rcl_allocator_t *allocator) {
    executor->most = handles;
    return context->valid && allocator ? RCL_RET_OK : RCL_RET_ERROR;
}
rcl_ret_t rclc_executor_add_subscription(rclc_executor_t *executor,
                                         rcl_subscription_t *subscription, void *message,
                                         rclc_subscription_callback_t callback,
                                         rclc_executor_handle_invocation_t when) {
    size_t k = executor->handles++;
    if (k >= executor->most || when != ON_NEW_DATA || executor->timer) return RCL_RET_ERROR;
    executor->heard[k].subscription = subscription;
    executor->heard[k].message = message;
    executor->heard[k].callback = callback;
    return RCL_RET_OK;
}
rcl_ret_t rclc_executor_add_timer(rclc_executor_t *executor, rcl_timer_t *timer) {
    executor->timer = timer;
    return executor->handles++ < executor->most ? RCL_RET_OK : RCL_RET_ERROR;
}
bool nav_msgs__msg__Odometry__init(nav_msgs__msg__Odometry *message) {
    memset(message, 0, sizeof *message);
    message->pose.pose.orientation.w = 1.0;
    return true;
}

static void hear(rclc_executor_t *executor, const char *topic, const char *type,
                 const void *message, size_t size) {
    size_t k;
    for (k = 0; k + 1 < executor->handles; k++) {
        rcl_subscription_t *one = executor->heard[k].subscription;
        if (strcmp(one->topic, topic) || strcmp(one->type, type)) continue;
        memcpy(executor->heard[k].message, message, size);
        executor->heard[k].callback(executor->heard[k].message);
    }
}

rcl_ret_t rclc_executor_spin(rclc_executor_t *executor) {
    int k;
    period = 1e-9 * (double)executor->timer->period;
    for (k = 0; k < steps; k++, given += GIVEN, taken += TAKEN) {
        if (given[0] != 0.0) {
            nav_msgs__msg__Odometry seen;
            memset(&seen, 0, sizeof seen);
            memcpy(&seen.pose.pose.orientation, given + 1, 4 * sizeof(double));
            seen.twist.twist.linear.x = given[5];
            seen.twist.twist.angular.z = given[6];
            hear(executor, "odometry", "nav_msgs/msg/Odometry", &seen, sizeof seen);
        }
        if (given[7] != 0.0) {
            std_msgs__msg__Float64 asked = {given[8]};
            hear(executor, "heading", "std_msgs/msg/Float64", &asked, sizeof asked);
        }
        executor->timer->callback(executor->timer, 0);
    }
    return RCL_RET_OK;
}

rcl_ret_t rcl_publish(const rcl_publisher_t *publisher, const void *message, void *allocation) {
    (void)allocation;
    if (!strcmp(publisher->topic, "rudder") && !strcmp(publisher->type, "std_msgs/msg/Float64"))
        taken[0] = ((const std_msgs__msg__Float64 *)message)->data;
    else if (!strcmp(publisher->topic, "fault") && !strcmp(publisher->type, "std_msgs/msg/Bool"))
        taken[1] = ((const std_msgs__msg__Bool *)message)->data;
    else
        return RCL_RET_ERROR;
    return RCL_RET_OK;
}
