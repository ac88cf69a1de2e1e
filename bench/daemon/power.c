/* Preloaded into a process, notes what it does to the files of $POWER_FOLDER in $POWER_JOURNAL.

   What a disk would keep of it, `bench.daemon.power` makes up. A line per call:

       w INODE FROM TO      bytes written      s INODE, S INODE    a file's sync begins, has ended
       n INODE PATH         a new name         d, D                a folder's sync begins, has ended
       u INODE PATH         a name taken away

   What has happened is noted after it has, what is promised before: so nothing counts as synced that
   may not be. $POWER_SLOW_MS is how long each sync of a file takes beside its own time. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <limits.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#define REAL(type, name, ...) ((type (*)(__VA_ARGS__))dlsym(RTLD_NEXT, #name))

static int journal = -1;
static const char *folder;
static size_t folder_length;
static long slow_us;

__attribute__((constructor)) static void begin(void)
{
    const char *path = getenv("POWER_JOURNAL"), *slow = getenv("POWER_SLOW_MS");
    folder = getenv("POWER_FOLDER");
    if (!path || !folder)
        return;
    folder_length = strlen(folder);
    slow_us = slow ? 1000 * atol(slow) : 0;
    journal = REAL(int, open, const char *, int, ...)(
        path, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0644);
}

static int is_mine(const char *path)
{
    return journal >= 0 && path && !strncmp(path, folder, folder_length)
        && (path[folder_length] == '/' || !path[folder_length]);
}

static int is_mine_open(int fd)
{
    char link[64], path[PATH_MAX];
    if (journal < 0)
        return 0;
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t n = readlink(link, path, sizeof path - 1);
    if (n < 0)
        return 0;
    path[n] = 0;
    return is_mine(path);
}

static void note(const char *format, ...)
{
    char line[PATH_MAX + 100];
    va_list arguments;
    va_start(arguments, format);
    int n = vsnprintf(line, sizeof line, format, arguments);
    va_end(arguments);
    if (REAL(ssize_t, write, int, const void *, size_t)(journal, line, n) != n)
        abort();
}

static unsigned long inode_of(const char *path)
{
    struct stat status;
    return lstat(path, &status) ? 0 : status.st_ino;
}

ssize_t write(int fd, const void *data, size_t size)
{
    ssize_t done = REAL(ssize_t, write, int, const void *, size_t)(fd, data, size);
    if (done > 0 && is_mine_open(fd)) {
        struct stat status;
        off_t end = lseek(fd, 0, SEEK_CUR);
        if (!fstat(fd, &status) && S_ISREG(status.st_mode))
            note("w %lu %ld %ld\n", status.st_ino, (long)(end - done), (long)end);
    }
    return done;
}

static int opened(int fd, const char *path, int flags)
{
    struct stat status;
    if (fd >= 0 && (flags & O_CREAT) && is_mine(path) && !fstat(fd, &status))
        note("n %lu %s\n", status.st_ino, path);
    return fd;
}

#define MODE                                                                                      \
    va_list arguments;                                                                            \
    va_start(arguments, flags);                                                                   \
    mode_t mode = va_arg(arguments, mode_t);                                                      \
    va_end(arguments)

int open(const char *path, int flags, ...)
{
    MODE;
    return opened(REAL(int, open, const char *, int, ...)(path, flags, mode), path, flags);
}

int open64(const char *path, int flags, ...)
{
    MODE;
    return opened(REAL(int, open64, const char *, int, ...)(path, flags, mode), path, flags);
}

int mkdir(const char *path, mode_t mode)
{
    int failed = REAL(int, mkdir, const char *, mode_t)(path, mode);
    if (!failed && is_mine(path))
        note("n %lu %s\n", inode_of(path), path);
    return failed;
}

int link(const char *from, const char *to)
{
    int failed = REAL(int, link, const char *, const char *)(from, to);
    if (!failed && is_mine(to))
        note("n %lu %s\n", inode_of(to), to);
    return failed;
}

int linkat(int from_fd, const char *from, int to_fd, const char *to, int flags)
{
    int failed = REAL(int, linkat, int, const char *, int, const char *, int)(
        from_fd, from, to_fd, to, flags);
    if (!failed && is_mine(to))
        note("n %lu %s\n", inode_of(to), to);
    return failed;
}

int rename(const char *from, const char *to)
{
    int failed = REAL(int, rename, const char *, const char *)(from, to);
    if (!failed && is_mine(to)) {
        note("n %lu %s\n", inode_of(to), to);
        note("u %lu %s\n", inode_of(to), from);
    }
    return failed;
}

int unlink(const char *path)
{
    unsigned long inode = inode_of(path);
    int failed = REAL(int, unlink, const char *)(path);
    if (!failed && is_mine(path))
        note("u %lu %s\n", inode, path);
    return failed;
}

static int synced(int fd, int (*sync)(int))
{
    struct stat status;
    if (!is_mine_open(fd) || fstat(fd, &status))
        return sync(fd);
    int is_folder = S_ISDIR(status.st_mode);
    is_folder ? note("d\n") : note("s %lu\n", status.st_ino);
    if (!is_folder && slow_us)
        usleep(slow_us);
    int failed = sync(fd);
    if (!failed)
        is_folder ? note("D\n") : note("S %lu\n", status.st_ino);
    return failed;
}

int fsync(int fd) { return synced(fd, REAL(int, fsync, int)); }

int fdatasync(int fd) { return synced(fd, REAL(int, fdatasync, int)); }
