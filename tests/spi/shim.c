/* LD_PRELOAD: /dev/spidev* becomes a connection to a server on the Unix socket $LINETRACK_SPI_SOCKET.
 *
 * Only what py-spidev needs. As the kernel's driver does, a message longer than bufsiz (4096 bytes,
 * or $LINETRACK_SPI_BUFSIZ) is refused with EMSGSIZE; settings are kept and given back.
 * A transfer goes out as u32 'T', u32 length, bytes, and as many bytes come back. The settings of
 * every transfer go ahead of it: u32 'S', u32 mode, u32 Hz, u32 bits per word.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/spi/spidev.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <unistd.h>

#define FILES 1024

static struct {
    int open;
    uint32_t mode, speed, bits;
} files[FILES];

static int is_spidev(const char *path) { return path && strncmp(path, "/dev/spidev", 11) == 0; }

static int connected(void) {
    const char *path = getenv("LINETRACK_SPI_SOCKET");
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    if (!path || strlen(path) >= sizeof address.sun_path) {
        errno = ENOENT;
        return -1;
    }
    strcpy(address.sun_path, path);
    int fd = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
    if (fd < 0) return -1;
    if (fd >= FILES || connect(fd, (struct sockaddr *)&address, sizeof address) < 0) {
        int error = fd >= FILES ? EMFILE : errno;
        close(fd);
        errno = error;
        return -1;
    }
    files[fd].open = 1;
    files[fd].mode = 0;
    files[fd].speed = 500000;
    files[fd].bits = 8;
    return fd;
}

static int is_ours(int fd) { return fd >= 0 && fd < FILES && files[fd].open; }

static int put(int fd, const void *data, size_t size) {
    for (const char *at = data; size;) {
        ssize_t n = send(fd, at, size, MSG_NOSIGNAL);
        if (n < 0 && errno == EINTR) continue;
        if (n <= 0) return errno = EIO, -1;
        at += n;
        size -= (size_t)n;
    }
    return 0;
}

static int get(int fd, void *data, size_t size) {
    for (char *at = data; size;) {
        ssize_t n = recv(fd, at, size, 0);
        if (n < 0 && errno == EINTR) continue;
        if (n <= 0) return errno = EIO, -1;
        at += n;
        size -= (size_t)n;
    }
    return 0;
}

static size_t bufsiz(void) {
    const char *text = getenv("LINETRACK_SPI_BUFSIZ");
    return text ? strtoul(text, NULL, 10) : 4096;
}

/* One message: its transfers' lengths together must fit the driver's buffer, in both directions. */
static int message(int fd, struct spi_ioc_transfer *parts, size_t count) {
    size_t total = 0;
    for (size_t n = 0; n < count; n++) {
        total += parts[n].len;
        if (parts[n].len > bufsiz() || total > bufsiz()) return errno = EMSGSIZE, -1;
    }
    for (size_t n = 0; n < count; n++) {
        uint32_t size = parts[n].len;
        uint32_t speed = parts[n].speed_hz ? parts[n].speed_hz : files[fd].speed;
        uint32_t head[] = {'S', files[fd].mode, speed, files[fd].bits, 'T', size};
        char *zeros = NULL, *sink = NULL;
        void *tx = (void *)(uintptr_t)parts[n].tx_buf, *rx = (void *)(uintptr_t)parts[n].rx_buf;
        if (!tx && !(tx = zeros = calloc(1, size + 1))) return errno = ENOMEM, -1;
        if (!rx && !(rx = sink = malloc(size + 1))) return free(zeros), errno = ENOMEM, -1;
        int failed = put(fd, head, sizeof head) || put(fd, tx, size) || get(fd, rx, size);
        int error = errno;
        free(zeros);
        free(sink);
        if (failed) return errno = error, -1;
    }
    return (int)total;
}

static int spidev_ioctl(int fd, unsigned long request, void *argument) {
    uint8_t *byte = argument;
    uint32_t *word = argument;
    if (_IOC_TYPE(request) != SPI_IOC_MAGIC) return errno = ENOTTY, -1;
    if (_IOC_NR(request) == 0)
        return message(fd, argument, _IOC_SIZE(request) / sizeof(struct spi_ioc_transfer));
    switch (request) {
    case SPI_IOC_RD_MODE: *byte = (uint8_t)files[fd].mode; return 0;
    case SPI_IOC_WR_MODE: files[fd].mode = *byte; return 0;
    case SPI_IOC_RD_MODE32: *word = files[fd].mode; return 0;
    case SPI_IOC_WR_MODE32: files[fd].mode = *word; return 0;
    case SPI_IOC_RD_LSB_FIRST: *byte = 0; return 0;
    case SPI_IOC_WR_LSB_FIRST: return *byte ? (errno = EINVAL, -1) : 0;
    case SPI_IOC_RD_BITS_PER_WORD: *byte = (uint8_t)files[fd].bits; return 0;
    case SPI_IOC_WR_BITS_PER_WORD:
        if (*byte != 8 && *byte != 0) return errno = EINVAL, -1;
        return 0;
    case SPI_IOC_RD_MAX_SPEED_HZ: *word = files[fd].speed; return 0;
    case SPI_IOC_WR_MAX_SPEED_HZ: files[fd].speed = *word; return 0;
    }
    return errno = EINVAL, -1;
}

#define REAL(name) __typeof__(name) *real = (__typeof__(name) *)dlsym(RTLD_NEXT, #name)

#define OPEN(name)                                               \
    int name(const char *path, int flags, ...) {                 \
        REAL(name);                                              \
        va_list list;                                            \
        va_start(list, flags);                                   \
        mode_t mode = va_arg(list, mode_t);                      \
        va_end(list);                                            \
        return is_spidev(path) ? connected() : real(path, flags, mode); \
    }

#define OPENAT(name)                                             \
    int name(int folder, const char *path, int flags, ...) {     \
        REAL(name);                                              \
        va_list list;                                            \
        va_start(list, flags);                                   \
        mode_t mode = va_arg(list, mode_t);                      \
        va_end(list);                                            \
        return is_spidev(path) ? connected() : real(folder, path, flags, mode); \
    }

OPEN(open)
OPEN(open64)
OPENAT(openat)
OPENAT(openat64)

int close(int fd) {
    REAL(close);
    if (is_ours(fd)) files[fd].open = 0;
    return real(fd);
}

int ioctl(int fd, unsigned long request, ...) {
    REAL(ioctl);
    va_list list;
    va_start(list, request);
    void *argument = va_arg(list, void *);
    va_end(list);
    return is_ours(fd) ? spidev_ioctl(fd, request, argument) : real(fd, request, argument);
}

ssize_t read(int fd, void *data, size_t size) {
    REAL(read);
    struct spi_ioc_transfer part = {.rx_buf = (uintptr_t)data, .len = (uint32_t)size};
    return is_ours(fd) ? message(fd, &part, 1) : real(fd, data, size);
}

ssize_t write(int fd, const void *data, size_t size) {
    REAL(write);
    struct spi_ioc_transfer part = {.tx_buf = (uintptr_t)data, .len = (uint32_t)size};
    return is_ours(fd) ? message(fd, &part, 1) : real(fd, data, size);
}
