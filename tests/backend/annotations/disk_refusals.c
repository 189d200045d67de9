// Refuses the n-th call of a kind on files below $REFUSE_ROOT: LD_PRELOAD it, then call arm().
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/types.h>
#include <unistd.h>

enum { SYNC, WRITE, SHORT, RENAME, CREATE };
static int wanted = -1, left = 0, refused = 0;

void arm(int kind, int nth) { wanted = kind, left = nth, refused = 0; }
int was_refused(void) { return refused; }

static int ours(const char *path) {
    const char *root = getenv("REFUSE_ROOT");
    return root && path && strncmp(path, root, strlen(root)) == 0;
}

static int ours_fd(int fd) {
    char link[64], path[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t n = readlink(link, path, sizeof path - 1);
    if (n < 0) return 0;
    path[n] = 0;
    return ours(path);
}

static int due(int kind, int below) {
    if (wanted != kind || !below || left <= 0 || --left) return 0;
    refused = 1;
    return 1;
}

#define REAL(type, name, ...) \
    static type (*real)(__VA_ARGS__); \
    if (!real) real = (type(*)(__VA_ARGS__))dlsym(RTLD_NEXT, name)

#define SYNCS(symbol) \
    int symbol(int fd) { \
        REAL(int, #symbol, int); \
        if (due(SYNC, ours_fd(fd))) return errno = EIO, -1; \
        return real(fd); \
    }
SYNCS(fsync)
SYNCS(fdatasync)

ssize_t write(int fd, const void *data, size_t size) {
    REAL(ssize_t, "write", int, const void *, size_t);
    int below = wanted >= 0 && ours_fd(fd);
    if (due(WRITE, below)) return errno = ENOSPC, -1;
    if (due(SHORT, below)) {
        // Half of it, and nothing of the next: a disk that became full.
        wanted = WRITE, left = 1;
        return real(fd, data, size / 2);
    }
    return real(fd, data, size);
}

#define PWRITES(symbol, offset_t) \
    ssize_t symbol(int fd, const void *data, size_t size, offset_t at) { \
        REAL(ssize_t, #symbol, int, const void *, size_t, offset_t); \
        int below = wanted >= 0 && ours_fd(fd); \
        if (due(WRITE, below)) return errno = ENOSPC, -1; \
        if (due(SHORT, below)) { \
            wanted = WRITE, left = 1; \
            return real(fd, data, size / 2, at); \
        } \
        return real(fd, data, size, at); \
    }
PWRITES(pwrite, off_t)
PWRITES(pwrite64, off64_t)

int rename(const char *from, const char *to) {
    REAL(int, "rename", const char *, const char *);
    if (due(RENAME, ours(to))) return errno = EIO, -1;
    return real(from, to);
}

#define OPENS(symbol) \
    int symbol(const char *path, int flags, ...) { \
        va_list list; \
        va_start(list, flags); \
        mode_t mode = flags & (O_CREAT | O_TMPFILE) ? va_arg(list, mode_t) : 0; \
        va_end(list); \
        REAL(int, #symbol, const char *, int, ...); \
        if (flags & O_CREAT && due(CREATE, ours(path))) return errno = ENOSPC, -1; \
        return real(path, flags, mode); \
    }
OPENS(open)
OPENS(open64)
