typedef double real;
#define LANES 1
#define AT(x, k) (x)
#define R(c) (c)
#define LOAD(p) (*(p))
#define STORE(p, x) (*(p) = (x))
#define TOTAL(x) (x)
#define r_exp exp
#define r_tanh tanh
#define r_asinh asinh
#define r_sqrt sqrt
#if defined(__GNUC__)
#define APART __attribute__((noinline, unused))
#else
#define APART
#endif
