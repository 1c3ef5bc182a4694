/* Written by `python -m acquisition.wiring header` from acquisition/wiring.toml. */
#ifndef WIRING_H
#define WIRING_H

#define CLOCK_HZ 84000000u
#define MASTER_CLOCK_HZ 4000000u

/* pins: port, number, alternate function where a peripheral has them */
#define FM_PORT GPIOB
#define FM_PIN 0u
#define FM_AF 2u /* TIM3_CH3 */
#define SH_PORT GPIOA
#define SH_PIN 1u
#define SH_AF 1u /* TIM2_CH2 */
#define ICG_PORT GPIOA
#define ICG_PIN 0u
#define ICG_AF 2u /* TIM5_CH1 */
#define OS_PORT GPIOC
#define OS_PIN 0u
#define ADC_CLOCK_PORT GPIOB
#define ADC_CLOCK_PIN 9u
#define ADC_CLOCK_AF 2u /* TIM4_CH4 */
#define SCLK_PORT GPIOB
#define SCLK_PIN 13u
#define SCLK_AF 5u /* SPI2_SCK */
#define MISO_PORT GPIOB
#define MISO_PIN 14u
#define MISO_AF 5u /* SPI2_MISO */
#define MOSI_PORT GPIOB
#define MOSI_PIN 15u
#define MOSI_AF 5u /* SPI2_MOSI */
#define READY_PORT GPIOB
#define READY_PIN 2u
#define SYNC_PORT GPIOB
#define SYNC_PIN 1u
#define HEARTBEAT_PORT GPIOA
#define HEARTBEAT_PIN 5u
#define LED0_PORT GPIOC
#define LED0_PIN 4u
#define LED1_PORT GPIOC
#define LED1_PIN 5u
#define LED2_PORT GPIOC
#define LED2_PIN 6u
#define LED3_PORT GPIOC
#define LED3_PIN 7u
#define LED4_PORT GPIOC
#define LED4_PIN 8u
#define LED5_PORT GPIOC
#define LED5_PIN 9u
#define CHAIN_CLOCK_PORT GPIOC
#define CHAIN_CLOCK_PIN 10u
#define CHAIN_CLOCK_AF 6u /* SPI3_SCK */
#define CHAIN_DATA_PORT GPIOC
#define CHAIN_DATA_PIN 12u
#define CHAIN_DATA_AF 6u /* SPI3_MOSI */
#define CHAIN_LATCH_PORT GPIOC
#define CHAIN_LATCH_PIN 3u
#define CHAIN_ENABLE_PORT GPIOC
#define CHAIN_ENABLE_PIN 2u

#define OS_CHANNEL 10u

/* LED channels */
#define LED_PORT GPIOC
#define LED_FIRST_PIN 4u
#define LED_GPIO_COUNT 6u
#define LED_CHAIN_FIRST 6u
#define LED_CHAIN_BITS 64u
#define LED_CHAIN_STEP 40u
#define LED_SECOND_TO_LAST 0u
#define LED_LAST 1u

/* sensor timing in master clocks, and the link */
#define ELEMENTS 3694u
#define CLOCKS_PER_ELEMENT 4u
#define LEADING_ELEMENTS 32u
#define PIXELS 3648u
#define DARK_FIRST 16u
#define DARK_COUNT 13u
#define FULL_SCALE 4095u
#define SH_MIN 40u
#define ICG_MIN 14776u
#define ICG_PULSE 20u
#define SH_PULSE 8u
#define ICG_DELAY 11u
#define SH_DELAY 12u
#define FLUSH_SH 20u
#define FLUSH_ICG 15000u
#define FLUSH_PULSES 4u
#define SPI_CLOCK_MAX 16000000u
#define SH_EDGE 9u
#define COMMAND_MAGIC_0 0x45u
#define COMMAND_MAGIC_1 0x52u
#define ORIGINAL_SIZE 7388u
#define MODE_ORIGINAL 0u
#define MODE_STREAM 1u
#define MODE_SPIKES 2u

/* stream mode */
#define STREAM_VERSION 1u
#define STREAM_MAGIC 21580u
#define STREAM_HEADER_SIZE 32u
#define STREAM_FRAME_SIZE 7424u
#define STREAM_TABLE_AT 16u
#define STREAM_TABLE_MAX 64u
#define STREAM_ENTRY_SIZE 12u
#define STREAM_EXPOSURE_MIN 10u
#define STREAM_EXPOSURE_CONTINUES 0x80000000u
#define STREAM_STALL_US 1000u
#define STREAM_ORIGINAL_STALL_US 50000u
#define FLAG_DROPPED 1u
#define FLAG_CHANGED 2u
#define FLAG_REFUSED 4u
#define FLAG_STATUS 8u
#define REFUSAL_NONE 0u
#define REFUSAL_VERSION 1u
#define REFUSAL_CHECKSUM 2u
#define REFUSAL_PERIODS 3u
#define REFUSAL_TABLE 4u
#define REFUSAL_MODE 5u

/* spikes mode, and the options of both */
#define SPIKES_VERSION 2u
#define SPIKES_FRAME_SIZE 256u
#define SPIKES_TABLE_AT 20u
#define SPIKES_ENTRY_SIZE 16u
#define SPIKES_NO_WINDOW 65535u
#define SPIKES_WINDOW_MIN 24u
#define SPIKES_WINDOWS_MAX 8u
#define SPIKES_SPIKES_MAX 8u
#define SPIKES_POSITION_SCALE 1024u
#define SPIKES_WIDTH_SCALE 16u
#define SPIKES_DARK_SCALE 16u
#define SPIKE_SATURATED 1u
#define SPIKE_CLIPPED 2u
#define SPIKE_DOUBLE 4u
#define SPIKE_REFLECTION 8u
#define OPTION_AWAIT_SYNC 1u
#define OPTION_BRIEF 2u

/* what toggling a flag, by bit, does to the checksum: a CRC is linear */
#define STREAM_FLAG_CHECKSUMS 0x6b271c72u, 0xd64e38e4u, 0xa85d6c7fu, 0x547bc549u
#define SPIKES_FLAG_CHECKSUMS 0x83ecb1e4u, 0x03187e7fu, 0x0630fcfeu, 0x0c61f9fcu

_Static_assert(CLOCK_HZ % MASTER_CLOCK_HZ == 0, "whole clocks");
_Static_assert(ICG_MIN == ELEMENTS * CLOCKS_PER_ELEMENT, "one read-out");
_Static_assert(ORIGINAL_SIZE == 2 * ELEMENTS, "elements have two bytes");
_Static_assert(STREAM_FRAME_SIZE == STREAM_HEADER_SIZE + ORIGINAL_SIZE + 4,
               "header, elements, checksum");
_Static_assert(STREAM_FRAME_SIZE % 4 == 0, "the CRC unit takes words");
_Static_assert(SPIKES_TABLE_AT + STREAM_TABLE_MAX * SPIKES_ENTRY_SIZE + 4 <= ORIGINAL_SIZE,
               "a command fits in a transfer");
_Static_assert(SH_EDGE < STREAM_EXPOSURE_MIN, "an LED goes on before ICG's edge");
_Static_assert(SH_EDGE < ICG_PULSE && ICG_PULSE < SH_MIN, "pulses do not overlap");
_Static_assert(LED_GPIO_COUNT <= LED_CHAIN_FIRST, "pins, then the chain");
_Static_assert(LED_CHAIN_BITS == 64, "one pattern is a uint64_t");

#endif
