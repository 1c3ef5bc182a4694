/* CRC unit: CRC-32 over words, polynomial 0x04C11DB7, initial value all ones. */
#include "machine.h"

void crc_reset(struct machine *m) { m->crc = (struct crc){.dr = 0xFFFFFFFFu}; }

uint32_t crc_read(struct machine *m, uint32_t offset) {
    if (offset == 0) return m->crc.dr;
    if (offset == 4) return m->crc.idr;
    fail(m, "%s is not modelled", register_name(m, 0x40023000u + offset));
    return 0;
}

static uint32_t add_word(uint32_t crc, uint32_t value) {
    static const uint32_t nibble[16] = {
        0x00000000u, 0x04C11DB7u, 0x09823B6Eu, 0x0D4326D9u, 0x130476DCu, 0x17C56B6Bu,
        0x1A864DB2u, 0x1E475005u, 0x2608EDB8u, 0x22C9F00Fu, 0x2F8AD6D6u, 0x2B4BCB61u,
        0x350C9B64u, 0x31CD86D3u, 0x3C8EA00Au, 0x384FBDBDu};
    crc ^= value;
    for (unsigned i = 0; i < 8; i++) crc = crc << 4 ^ nibble[crc >> 28];
    return crc;
}

void crc_write(struct machine *m, uint32_t offset, uint32_t value) {
    if (offset == 0)
        m->crc.dr = add_word(m->crc.dr, value);
    else if (offset == 4)
        m->crc.idr = value & 0xFFu;
    else if (offset == 8 && !(value & ~1u)) {
        if (value) m->crc.dr = 0xFFFFFFFFu;
    } else
        fail(m, "%s is not modelled", register_name(m, 0x40023000u + offset));
}
