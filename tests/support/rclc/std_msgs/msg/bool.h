#ifndef STD_MSGS_BOOL_H
#define STD_MSGS_BOOL_H
#include <stdbool.h>

typedef struct { bool data; } std_msgs__msg__Bool;
#endif
