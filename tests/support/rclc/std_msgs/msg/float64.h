#ifndef STD_MSGS_FLOAT64_H
#define STD_MSGS_FLOAT64_H

typedef struct { double data; } std_msgs__msg__Float64;
#endif
