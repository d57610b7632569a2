#ifndef RCLC_EXECUTOR_H
#define RCLC_EXECUTOR_H
#include <rcl/rcl.h>

typedef void (*rclc_subscription_callback_t)(const void *);
typedef enum { ON_NEW_DATA, ALWAYS } rclc_executor_handle_invocation_t;
typedef struct {
    size_t handles, most;
    rcl_timer_t *timer;
    struct {
        rcl_subscription_t *subscription;
        void *message;
        rclc_subscription_callback_t callback;
    } heard[4];
} rclc_executor_t;

rclc_executor_t rclc_executor_get_zero_initialized_executor(void);
rcl_ret_t rclc_executor_init(rclc_executor_t *executor, rcl_context_t *context,
                             const size_t handles, const rcl_allocator_t *allocator);
rcl_ret_t rclc_executor_add_subscription(rclc_executor_t *executor,
                                         rcl_subscription_t *subscription, void *message,
                                         rclc_subscription_callback_t callback,
                                         rclc_executor_handle_invocation_t when);
rcl_ret_t rclc_executor_add_timer(rclc_executor_t *executor, rcl_timer_t *timer);
rcl_ret_t rclc_executor_spin(rclc_executor_t *executor);
#endif
