/* The part of rcl's and rclc's interfaces that exported nodes use, by their documentation. */
#ifndef RCL_H
#define RCL_H
#include <stddef.h>
#include <stdint.h>

typedef int32_t rcl_ret_t;
#define RCL_RET_OK 0
#define RCL_RET_ERROR 1
typedef struct { int unused; } rcl_allocator_t;
typedef struct { int valid; } rcl_context_t;
typedef struct { const char *name; } rcl_node_t;
typedef struct { const char *topic, *type; } rcl_publisher_t;
typedef struct { const char *topic, *type; } rcl_subscription_t;
typedef struct rcl_timer_s {
    uint64_t period;
    void (*callback)(struct rcl_timer_s *, int64_t);
} rcl_timer_t;
typedef void (*rcl_timer_callback_t)(rcl_timer_t *, int64_t);
typedef const char rosidl_message_type_support_t;
#define ROSIDL_GET_MSG_TYPE_SUPPORT(package, kind, name) (#package "/" #kind "/" #name)

rcl_allocator_t rcl_get_default_allocator(void);
rcl_node_t rcl_get_zero_initialized_node(void);
rcl_publisher_t rcl_get_zero_initialized_publisher(void);
rcl_subscription_t rcl_get_zero_initialized_subscription(void);
rcl_timer_t rcl_get_zero_initialized_timer(void);
rcl_ret_t rcl_publish(const rcl_publisher_t *publisher, const void *message, void *allocation);
#endif
