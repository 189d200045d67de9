// Writes down, in their order, all operations on files below $TRACE_ROOT, with their data:
// LD_PRELOAD it, and read the log $TRACE_LOG with disk_model.py. Built by the test, in a second.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static int out = -1;

static int ours(const char *path) {
    const char *root = getenv("TRACE_ROOT");
    return root && path && strncmp(path, root, strlen(root)) == 0;
}

static int ours_fd(int fd, char *path) {
    char link[64];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t n = readlink(link, path, 4095);
    if (n < 0) return 0;
    path[n] = 0;
    return ours(path);
}

static uint64_t inode(int fd) {
    struct stat s;
    return fstat(fd, &s) ? 0 : s.st_ino;
}

static void put(const void *data, size_t size) {
    const char *p = data;
    while (size) {
        long n = syscall(SYS_write, out, p, size);
        if (n <= 0) abort();
        p += n, size -= n;
    }
}

// One record: kind, inode, offset, lengths of two paths and of the data, then these three.
static void note(char kind, uint64_t ino, int64_t offset, const char *path, const char *other,
                 const void *data, uint64_t size) {
    pthread_mutex_lock(&lock);
    if (out < 0) {
        const char *name = getenv("TRACE_LOG");
        out = name ? syscall(SYS_openat, AT_FDCWD, name, O_WRONLY | O_CREAT | O_APPEND, 0600) : -1;
        if (out < 0) abort();
    }
    uint32_t a = strlen(path), b = strlen(other);
    put(&kind, 1), put(&ino, 8), put(&offset, 8), put(&a, 4), put(&b, 4), put(&size, 8);
    put(path, a), put(other, b), put(data, size);
    pthread_mutex_unlock(&lock);
}

#define REAL(type, name, ...) \
    static type (*real)(__VA_ARGS__); \
    if (!real) real = (type(*)(__VA_ARGS__))dlsym(RTLD_NEXT, name)

static int opened(int fd, int flags) {
    char absolute[4096];
    if (fd >= 0 && (flags & (O_CREAT | O_TRUNC)) && ours_fd(fd, absolute))
        note(flags & O_TRUNC ? 'T' : 'O', inode(fd), 0, absolute, "", "", 0);
    return fd;
}

#define OPEN(symbol) \
    int symbol(const char *path, int flags, ...) { \
        va_list list; \
        va_start(list, flags); \
        mode_t mode = flags & (O_CREAT | O_TMPFILE) ? va_arg(list, mode_t) : 0; \
        va_end(list); \
        REAL(int, #symbol, const char *, int, ...); \
        return opened(real(path, flags, mode), flags); \
    }
OPEN(open)
OPEN(open64)

ssize_t write(int fd, const void *data, size_t size) {
    REAL(ssize_t, "write", int, const void *, size_t);
    char path[4096];
    if (!ours_fd(fd, path)) return real(fd, data, size);
    struct stat s;
    fstat(fd, &s);
    int64_t at = fcntl(fd, F_GETFL) & O_APPEND ? s.st_size : lseek(fd, 0, SEEK_CUR);
    ssize_t n = real(fd, data, size);
    if (n > 0) note('W', s.st_ino, at, path, "", data, n);
    return n;
}

#define PWRITE(symbol) \
    ssize_t symbol(int fd, const void *data, size_t size, off_t at) { \
        REAL(ssize_t, #symbol, int, const void *, size_t, off_t); \
        char path[4096]; \
        ssize_t n = real(fd, data, size, at); \
        if (n > 0 && ours_fd(fd, path)) note('W', inode(fd), at, path, "", data, n); \
        return n; \
    }
PWRITE(pwrite)
PWRITE(pwrite64)

#define FTRUNCATE(symbol) \
    int symbol(int fd, off_t size) { \
        REAL(int, #symbol, int, off_t); \
        char path[4096]; \
        int failed = real(fd, size); \
        if (!failed && ours_fd(fd, path)) note('L', inode(fd), size, path, "", "", 0); \
        return failed; \
    }
FTRUNCATE(ftruncate)
FTRUNCATE(ftruncate64)

// Noted once it has returned: until then, what is not on the disk yet may be lost.
#define SYNC(symbol) \
    int symbol(int fd) { \
        REAL(int, #symbol, int); \
        char path[4096]; \
        int failed = real(fd); \
        if (!failed && ours_fd(fd, path)) note('S', inode(fd), 0, path, "", "", 0); \
        return failed; \
    }
SYNC(fsync)
SYNC(fdatasync)

int rename(const char *path, const char *other) {
    REAL(int, "rename", const char *, const char *);
    int failed = real(path, other);
    if (!failed && ours(path)) note('R', 0, 0, path, other, "", 0);
    return failed;
}

int unlink(const char *path) {
    REAL(int, "unlink", const char *);
    int failed = real(path);
    if (!failed && ours(path)) note('U', 0, 0, path, "", "", 0);
    return failed;
}

int mkdir(const char *path, mode_t mode) {
    REAL(int, "mkdir", const char *, mode_t);
    int failed = real(path, mode);
    struct stat s;
    if (!failed && ours(path) && !stat(path, &s)) note('M', s.st_ino, 0, path, "", "", 0);
    return failed;
}
